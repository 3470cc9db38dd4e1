"""Many pairs of files: reading, matching and writing at once, with a manifest of what became of each."""

from stereokit.batch.job import MatchedPair, MoreFiles
from stereokit.batch.manifest import MANIFEST_NAME, PairRecord, Records
from stereokit.batch.matching import Summary, match_files
from stereokit.batch.pipeline import read_ahead, run_pipeline

__all__ = [
    "MANIFEST_NAME",
    "MatchedPair",
    "MoreFiles",
    "PairRecord",
    "Records",
    "Summary",
    "match_files",
    "read_ahead",
    "run_pipeline",
]
