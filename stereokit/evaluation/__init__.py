"""Evaluation: any matcher on any data sets, with numbers that can be repeated and pictures of the failures."""

from stereokit.evaluation.evaluate import Observer, evaluate
from stereokit.evaluation.matcher import BatchMatcher, Matcher, NetworkMatcher, describe_matcher
from stereokit.evaluation.report import Report
from stereokit.evaluation.results import DatasetResult, Evaluation, PairLog, PairResult
from stereokit.evaluation.sgbm import SGBM_VARIANTS, SemiGlobalMatcher, fill_from_background
from stereokit.evaluation.submission import KittiSubmission

__all__ = [
    "SGBM_VARIANTS",
    "BatchMatcher",
    "DatasetResult",
    "Evaluation",
    "KittiSubmission",
    "Matcher",
    "NetworkMatcher",
    "Observer",
    "PairLog",
    "PairResult",
    "Report",
    "SemiGlobalMatcher",
    "describe_matcher",
    "evaluate",
    "fill_from_background",
]
