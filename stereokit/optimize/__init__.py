"""Networks made fast: for inference, for training, and for the memory that both run in."""

from stereokit.optimize.inference import PreparedNetwork, prepare_for_inference
from stereokit.optimize.training import copy_state, prepare_for_training
from stereokit.runtime.memory.freed import keep_freed_memory

__all__ = ["PreparedNetwork", "copy_state", "keep_freed_memory", "prepare_for_inference", "prepare_for_training"]
