"""How well estimators do: figures while they run, and a verdict at the end.

`metrics` and `alignment` are the mathematics, `record` what was said, `judging` the figures and
thresholds, `results` the files, `node` the node.
"""

from nodes.evaluation.node import Evaluation, EvaluationConfig

__all__ = ["Evaluation", "EvaluationConfig"]
