"""Smooth surfaces as disparity over the left view's coordinates, and their exact place in the right view."""

from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
import numpy.typing as npt

from stereokit.errors import InputError

__all__ = ["Array", "Surface", "Wave"]

Array: TypeAlias = npt.NDArray[np.float32]

_STEEPEST = 0.8
_NEWTON_STEPS = 4


@dataclass(frozen=True)
class Wave:
    """A ripple A sin(p du + q dv + phase) of a surface.

    Attributes:
        amplitude: A in pixels of disparity.
        across: p in radians a pixel.
        down: q in radians a pixel.
        phase: in radians.
    """

    amplitude: float
    across: float
    down: float
    phase: float


@dataclass(frozen=True)
class Surface:
    """Disparity d(u, v) of the surface point that the left view sees at column u and row v.

    With du = u - u0, dv = v - v0 and w = du clipped to +-reach:

        d = disparity + b du + c dv + Q (2 w du - w^2) + R dv^2 + sum of waves

    which is a plane, bent like a cylinder or a bowl (and going on straight beyond the reach), with ripples. A plane in
    space is a plane in disparity. The right view sees the point at u - d(u, v).

    Attributes:
        centre: (u0, v0).
        disparity: at the centre, without waves.
        slope: (b, c), pixels of disparity a pixel.
        bend: (Q, R).
        reach: how far from the centre column the surface is bent.
        waves: the ripples.

    Raises:
        InputError: |dd/du| could come near 1, where a surface folds over itself in the right view.

    >>> wall = Surface(centre=(0.0, 0.0), disparity=4.0, slope=(0.5, 0.0))
    >>> columns, rows = np.float32([[10.0]]), np.float32([[0.0]])
    >>> wall.disparity_at(columns, rows).item()
    9.0
    >>> wall.left_columns(columns - 9, rows).item()
    10.0
    """

    centre: tuple[float, float]
    disparity: float
    slope: tuple[float, float] = (0.0, 0.0)
    bend: tuple[float, float] = (0.0, 0.0)
    reach: float = 0.0
    waves: tuple[Wave, ...] = ()

    def __post_init__(self) -> None:
        steepest = abs(self.slope[0]) + 2 * abs(self.bend[0]) * self.reach
        steepest += sum(abs(wave.amplitude * wave.across) for wave in self.waves)
        if steepest > _STEEPEST:
            raise InputError(
                f"a surface changes by up to {steepest:.2f} px of disparity a column; expected at most {_STEEPEST}"
            )

    @property
    def is_plane(self) -> bool:
        """Whether it is flat."""
        return not (self.waves or any(self.bend))

    def disparity_at(self, u: Array, v: Array) -> Array:
        """Disparity at columns u (rows, columns) and rows v (rows, 1) of the left view."""
        du, dv = u - np.float32(self.centre[0]), v - np.float32(self.centre[1])
        disparity = np.float32(self.slope[0]) * du
        disparity += self._of_row(dv)
        if self.bend[0]:
            w = np.clip(du, np.float32(-self.reach), np.float32(self.reach))
            disparity += np.float32(self.bend[0]) * w * (2 * du - w)
        for wave in self.waves:
            disparity += np.float32(wave.amplitude) * np.sin(self._angle(wave, du, dv))
        return disparity

    def left_columns(self, x: Array, v: Array) -> Array:
        """The columns u where u - d(u, v) = x: where the left view sees what the right view sees at x.

        In closed form for a plane. Else by Newton's method, to about a ten-thousandth of a pixel.
        """
        dv = v - np.float32(self.centre[1])
        offset = self._of_row(dv) - np.float32(self.centre[0])
        du = (x + offset) * np.float32(1 / (1 - self.slope[0]))
        if self.is_plane:
            return du + np.float32(self.centre[0])
        target = x + offset
        for _ in range(_NEWTON_STEPS):
            value = du * np.float32(1 - self.slope[0])
            value -= target
            gradient = np.full_like(du, 1 - self.slope[0])
            if self.bend[0]:
                w = np.clip(du, np.float32(-self.reach), np.float32(self.reach))
                value -= np.float32(self.bend[0]) * w * (2 * du - w)
                gradient -= np.float32(2 * self.bend[0]) * w
            for wave in self.waves:
                angle = self._angle(wave, du, dv)
                value -= np.float32(wave.amplitude) * np.sin(angle)
                gradient -= np.float32(wave.amplitude * wave.across) * np.cos(angle)
            value /= gradient
            du -= value
        return du + np.float32(self.centre[0])

    def span(self, half_width: float, half_height: float) -> tuple[float, float]:
        """Bounds of the disparity within a rectangle around the centre."""
        vary = abs(self.slope[0]) * half_width + abs(self.slope[1]) * half_height
        vary += sum(abs(wave.amplitude) for wave in self.waves)
        w = min(half_width, self.reach)
        bends = self.bend[0] * w * (2 * half_width - w), self.bend[1] * half_height**2
        low = sum(min(bend, 0.0) for bend in bends)
        high = sum(max(bend, 0.0) for bend in bends)
        return self.disparity - vary + low, self.disparity + vary + high

    def _of_row(self, dv: Array) -> Array:
        """The terms that depend on the row alone."""
        result: Array = np.float32(self.disparity) + dv * (np.float32(self.slope[1]) + np.float32(self.bend[1]) * dv)
        return result

    @staticmethod
    def _angle(wave: Wave, du: Array, dv: Array) -> Array:
        angle: Array = np.float32(wave.across) * du
        angle += np.float32(wave.down) * dv + np.float32(wave.phase)
        return angle
