"""How well estimators do: figures while they run, and a verdict at the end.

`metrics` and `alignment` are the mathematics, `record` holds what an estimator sent, `judging`
makes figures and a verdict of it, `results` writes the files, and `node` is the node.
"""

from nodes.evaluation.node import Evaluation, EvaluationConfig

__all__ = ["Evaluation", "EvaluationConfig"]
