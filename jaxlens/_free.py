"""A number of a `strong.toml`: fixed, or free in a box with a prior; an elongation free with its angle."""

from typing import Annotated, Literal

from pydantic import Field, model_validator

from jaxlens._config import Strict


class Free(Strict):
    """A free number in a box.

    Attributes:
        min, max: limits.
        start: where the first start has it; the middle of the box if absent.
        log: uniform in the logarithm.
        mean, sigma: a normal prior on top of the box.
        prior: the name of the law, if it is to be said: `uniform`, `normal` or `log_normal`.
        median, sigma_ln: a log-normal prior on top of the box; `sigma_ln` is the spread of the natural
            logarithm. The box must begin above 0.
    """

    min: float
    max: float
    start: float | None = None
    log: bool = False
    mean: float | None = None
    sigma: Annotated[float, Field(gt=0)] | None = None
    prior: Literal["uniform", "normal", "log_normal"] | None = None
    median: Annotated[float, Field(gt=0)] | None = None
    sigma_ln: Annotated[float, Field(gt=0)] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> "Free":
        if not self.min < self.max:
            raise ValueError(f"min = {self.min} is not below max = {self.max}; correct the limits")
        if self.log and self.min <= 0:
            raise ValueError(f"log = true needs min > 0, but min = {self.min}; raise it, or leave out log")
        if self.start is not None and not self.min <= self.start <= self.max:
            raise ValueError(
                f"start = {self.start} is outside min = {self.min}, max = {self.max}; "
                "move it, or widen the box"
            )
        if (self.mean is None) != (self.sigma is None):
            raise ValueError("a normal prior needs both mean and sigma; add the other, or leave out both")
        if (self.median is None) != (self.sigma_ln is None):
            raise ValueError(
                "a log-normal prior needs both median and sigma_ln; add the other, or leave out both"
            )
        if self.mean is not None and self.median is not None:
            raise ValueError("mean, sigma and median, sigma_ln are two priors; leave out one pair")
        self._named()
        if self.median is not None and self.min <= 0:
            raise ValueError(
                f"a log-normal prior needs min > 0, but min = {self.min}; raise it, or give mean and sigma"
            )
        return self

    def _named(self) -> None:
        keys = {"uniform": "no further keys", "normal": "mean and sigma", "log_normal": "median and sigma_ln"}
        law = "normal" if self.mean is not None else "log_normal" if self.median is not None else "uniform"
        if self.prior is not None and self.prior != law:
            raise ValueError(
                f'prior = "{self.prior}" takes {keys[self.prior]}, but those of "{law}" are given; '
                "correct one of them"
            )


class FreeShape(Strict):
    """Ellipticity (or shear) and position angle free together, ellipticity below `max`."""

    max: Annotated[float, Field(gt=0, lt=1)]
    start: tuple[float, float] | None = None
    """First start: ellipticity, and position angle in degrees."""


Number = float | Free
