"""Evaluation of estimators: live figures (see `runtime.figures`), and a verdict at the end."""

from nodes.judging.evaluation.node import Evaluation, EvaluationConfig

__all__ = ["Evaluation", "EvaluationConfig"]
