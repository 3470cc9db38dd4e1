"""Devices by name."""

import torch

from stereokit.errors import ConfigError

__all__ = ["choose_device"]


def choose_device(device: str | torch.device = "auto") -> torch.device:
    """The device of that name; for "auto" a GPU if there is one.

    Raises:
        ConfigError: torch knows no such device, or this machine has none.

    >>> choose_device("cpu")
    device(type='cpu')
    """
    if device == "auto":
        return torch.accelerator.current_accelerator(check_available=True) or torch.device("cpu")
    try:
        chosen = torch.device(device)
        if chosen.type == "meta":
            raise RuntimeError("it holds no values")
        torch.empty(0, device=chosen)
    except Exception as error:
        # backends that are not built in fail as they like
        reason = str(error).strip().split("\n")[0]
        raise ConfigError(f"device {str(device)!r} can't be used; use 'auto' or 'cpu' ({reason})") from error
    return chosen
