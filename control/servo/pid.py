"""PID for one joint on plain floats: filtered derivative, anti-windup, bump-less start, limits per cycle.

    output = feedforward + kp * error + ki * integral(error) + kd * filtered(error rate)

The derivative filter is of first order, discretised by backward Euler (stable for any filter time).
Anti-windup: the integral is frozen while it would push the output further into its limit, and it alone
never exceeds the limits. So it recovers with the error's sign and follows narrowed limits.
"""

from dataclasses import asdict

from control.dynamics.gains import Gains
from control.errors import ArmError

# A finite bound: one chained comparison rejects NaN and both infinities at once.
_LARGEST = 1e300


class NonFiniteInput(ArmError):
    """A NaN or infinite number reached the controller; its state is unchanged."""


class Pid:
    """One joint's controller; units are the caller's, e.g. [V/rad], [V/(rad s)], [V s/rad] on [rad].

    Raises:
        ArmError: a gain or limit is negative or not finite, or the period is not positive.
    """

    __slots__ = ("_blend", "_error", "_period_s", "_rate", "_step", "integral", "is_saturated", "kd", "ki", "kp", "output_limit")

    def __init__(self, gains: Gains, output_limit: float, period_s: float) -> None:
        _require_sane(gains, output_limit, period_s)
        self.kp, self.ki, self.kd, self.output_limit = gains.kp, gains.ki, gains.kd, output_limit
        self.integral = 0.0  # in units of the output: changing ki later causes no bump
        self.is_saturated = False
        self._period_s = period_s
        self._step = gains.ki * period_s
        self._blend = period_s / (gains.derivative_filter_s + period_s)
        self._rate = 0.0
        self._error: float | None = None

    def update(
        self,
        error: float,
        error_rate: float | None = None,
        feedforward: float = 0.0,
        lower: float | None = None,
        upper: float | None = None,
    ) -> float:
        """Output of this cycle for error = set - measured.

        `error_rate` is set speed minus measured speed; pass minus the measured speed to keep steps of the
        set-point out of the derivative, or None to difference the error. `lower` and `upper` replace the
        limits -output_limit and output_limit for this cycle.

        Raises:
            NonFiniteInput: any input is NaN or infinite; nothing is changed.
        """
        if error_rate is None:
            error_rate = 0.0 if self._error is None else (error - self._error) / self._period_s
        if lower is None:
            lower = -self.output_limit
        if upper is None:
            upper = self.output_limit
        rate = self._rate + self._blend * (error_rate - self._rate)
        step = self._step * error
        rest = feedforward + self.kp * error + self.kd * rate
        wanted = rest + self.integral + step
        if not (-_LARGEST < wanted < _LARGEST and -_LARGEST < lower <= upper < _LARGEST and rate - rate == 0.0):
            raise NonFiniteInput(_describe(error, error_rate, feedforward, lower, upper))
        self._rate = rate
        self._error = error
        if lower <= wanted <= upper:
            self.is_saturated = False
            self.integral += step
            return wanted
        self.is_saturated = True
        is_unwinding = (wanted > upper) == (step < 0.0)
        self._hold_integral(step if is_unwinding else 0.0, lower - feedforward, upper - feedforward)
        return upper if wanted > upper else lower

    def _hold_integral(self, step: float, lower: float, upper: float) -> None:
        """Integrate only if it unwinds, then clamp the integral to what the limits leave beside the feed-forward.

        The bounds include zero: the integral need not oppose feed-forward beyond a limit.
        """
        self.integral = min(max(self.integral + step, min(lower, 0.0)), max(upper, 0.0))

    def reset(self, output: float = 0.0, error: float = 0.0, feedforward: float = 0.0, error_rate: float = 0.0) -> None:
        """Start bump-less: the next update with these same inputs returns `output` (plus one step of ki).

        Without integral action (ki = 0) nothing could hold a bias, and the integral becomes zero.

        Raises:
            NonFiniteInput: any input is NaN or infinite; nothing is changed.
        """
        bias = output - feedforward - self.kp * error - self.kd * error_rate
        if not -_LARGEST < bias < _LARGEST:
            raise NonFiniteInput(_describe(error, error_rate, feedforward, output, output))
        self._rate, self._error, self.is_saturated = error_rate, error, False
        self.integral = bias if self.ki > 0.0 else 0.0


def _require_sane(gains: Gains, output_limit: float, period_s: float) -> None:
    """Raise ArmError for the first invalid parameter."""
    for name, value in (*asdict(gains).items(), ("output_limit", output_limit)):
        if not 0.0 <= value < _LARGEST:
            raise ArmError(f"PID: {name} must be finite and not negative, got {value}")
    if not 0.0 < period_s < _LARGEST:
        raise ArmError(f"PID: period_s must be positive, got {period_s}")


def _describe(error: float, error_rate: float, feedforward: float, lower: float, upper: float) -> str:
    """Message with every input, so that the log shows the invalid one."""
    return (
        f"PID: expected finite inputs, got error {error}, error rate {error_rate},"
        f" feed-forward {feedforward}, limits {lower} to {upper}; the output was not changed"
    )
