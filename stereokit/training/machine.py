"""What a run trains on; none of it changes what it comes to, to within floating point."""

from dataclasses import dataclass

from stereokit.errors import ConfigError
from stereokit.training.fields import check_fields

__all__ = ["Machine"]


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Devices, precision, processes, and how often a run is written down and validated.

    A run that is resumed may have another one.

    Attributes:
        accelerator: "auto", "cpu", "gpu", ..., as in `lightning.pytorch.Trainer`.
        devices: how many on each machine; "auto"; or which ones, such as "1," or "0,2".
        nodes: how many machines.
        precision: "32", "bf16-mixed", "16-mixed", ..., as in `lightning.pytorch.Trainer`.
        compile: train through `torch.compile`.
        workers: processes that read and augment, for each training process; None goes by the cores.
        checkpoint_every: steps between checkpoints.
        validate_every: steps between validations.

    Raises:
        ConfigError: a value of another type or out of range. What this machine does not have, `train` finds out.

    >>> Machine(devices=2, precision="bf16-mixed").workers is None
    True
    >>> Machine(workers=-1)
    Traceback (most recent call last):
    stereokit.errors.ConfigError: machine: workers is -1; expected at least 0
    """

    accelerator: str = "auto"
    devices: int | str = "auto"
    nodes: int = 1
    precision: str = "32"
    compile: bool = False
    workers: int | None = None
    checkpoint_every: int = 200
    validate_every: int = 1000

    def __post_init__(self) -> None:
        check_fields("machine", self)
        for name, least in {"devices": 1, "nodes": 1, "workers": 0, "checkpoint_every": 1, "validate_every": 1}.items():
            value = getattr(self, name)
            if isinstance(value, int) and value < least:
                raise ConfigError(f"machine: {name} is {value}; expected at least {least}")
