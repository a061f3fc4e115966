"""The classical Runge-Kutta method of fourth order (Hairer, Norsett and Wanner 1993, Sec. II.1)."""

from collections.abc import Callable, Sequence

from torch import Tensor


def rk4_step(
    rate: Callable[[list[Tensor]], Sequence[Tensor]], start: Sequence[Tensor], seconds: Tensor | float
) -> list[Tensor]:
    """Returns the components of y `seconds` s after `start`; `rate` maps components of y to those of dy/dt."""

    def after(time: Tensor | float, slope: Sequence[Tensor]) -> list[Tensor]:
        return [y_i + time * slope_i for y_i, slope_i in zip(start, slope, strict=True)]

    k1 = rate(list(start))
    k2 = rate(after(seconds / 2, k1))
    k3 = rate(after(seconds / 2, k2))
    k4 = rate(after(seconds, k3))
    mean = [k1_i + 2.0 * (k2_i + k3_i) + k4_i for k1_i, k2_i, k3_i, k4_i in zip(k1, k2, k3, k4, strict=True)]
    return after(seconds / 6.0, mean)
