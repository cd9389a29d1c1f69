"""An estimate with everything in it, for the tests of what is sent and written."""

from estimator.estimates import Convergence, Coverage, Estimate, Marginal, Status

MARGINAL = Marginal(mean=27190.0, sd=310.0, q05=26700.0, q50=27180.0, q95=27700.0)


def made_estimate(t: float = 0.0, status: Status = Status.ESTIMATED) -> Estimate:
    """The estimate at time ``t`` [s]: MARGINAL stands for each parameter."""
    return Estimate(
        t=t,
        status=status,
        reason="",
        coverage=Coverage(30, 40),
        admitted=12345,
        mass=MARGINAL,
        A=MARGINAL,
        C=MARGINAL,
        convergence=Convergence(r_hat=1, ess_bulk=1, acceptance=1, draws=1, chains=3),
    )
