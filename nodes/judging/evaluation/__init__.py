"""How well estimators do: figures while they run, and a verdict at the end.

`metrics`, `alignment` and `coverage` are the mathematics, `record` holds what an estimator sent,
`judging` makes figures of it, `verdict` says whether they will do, `results` writes the files, and
`node` is the node. What each figure means is in `runtime.figures`.
"""

from nodes.judging.evaluation.node import Evaluation, EvaluationConfig

__all__ = ["Evaluation", "EvaluationConfig"]
