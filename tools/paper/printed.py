"""The numbers printed in the paper: Tables 1 to 5 of SAE 2017-01-0528, in its units."""

from dataclasses import dataclass

import numpy as np

from estimator.signals import Floats


@dataclass(frozen=True, kw_only=True)
class PrintedCycle:
    """Printed results of one cycle; parameters are [A, C, m] in lbf, lbf/mph^2 and slug (printed as "lbm").

    ``estimates`` (n, 3) and residual ``rms`` (n,) [hp] of the runs: Tables 2-4. ``mean`` and ``sd`` (3,) over the
    runs: Table 1. ``log10_eigenvalues`` (3,), from large to small, and ``angles`` (3,) [deg], in the order of the
    columns that are headed A, C, m: Table 5.
    """

    name: str
    table: int
    estimates: Floats
    rms: Floats
    mean: Floats
    sd: Floats
    log10_eigenvalues: Floats
    angles: Floats


def _runs(text: str) -> tuple[Floats, Floats]:
    """Estimates [A, C, m] and rms [hp] from rows "m, A, C, rms", the order in which the paper prints them."""
    rows = np.array([[float(x) for x in row.split()] for row in text.strip().splitlines()])
    return rows[:, [1, 2, 0]], rows[:, 3]


_HWFET = _runs(
    """
    1883 256.9 0.165 6.811
    1883 261.9 0.164 6.461
    1879 255.7 0.165 5.246
    1888 256.6 0.166 4.835
    1887 242.2 0.169 7.210
    1878 253.8 0.168 5.943
    1878 261.5 0.163 6.718
    1892 268.9 0.164 7.400
    1879 294.9 0.156 7.401
    1878 275.7 0.162 7.175
    """
)
_COMMUT = _runs(
    """
    1903 178.8 0.196 6.748
    1894 214.9 0.183 5.445
    1824 403.3 0.122 5.629
    1830 428.5 0.113 6.434
    1897 183.4 0.191 6.665
    1908 176.9 0.195 4.639
    1841 366.6 0.132 5.909
    1845 324.4 0.144 7.270
    1892 178.1 0.196 6.322
    1861 282.3 0.163 6.003
    """
)
_HHDDTNC = _runs(
    """
    1891 258.1 0.168 5.009
    1883 273.0 0.164 4.475
    1888 261.2 0.167 4.202
    1884 259.2 0.167 4.528
    1890 281.9 0.160 4.565
    1886 286.8 0.159 5.099
    1889 271.5 0.164 4.904
    1883 270.0 0.165 4.488
    """
)

PRINTED = {
    cycle.name: cycle
    for cycle in (
        PrintedCycle(
            name="HWFET",
            table=2,
            estimates=_HWFET[0],
            rms=_HWFET[1],
            mean=np.array([263.0, 0.164, 1883.0]),
            sd=np.array([14.4, 0.004, 4.86]),
            log10_eigenvalues=np.array([13.41, 5.800, 4.940]),
            angles=np.array([18.70, 18.70, 0.020]),
        ),
        PrintedCycle(
            name="COMMUT",
            table=3,
            estimates=_COMMUT[0],
            rms=_COMMUT[1],
            mean=np.array([274.0, 0.164, 1870.0]),
            sd=np.array([101.0, 0.033, 32.5]),
            log10_eigenvalues=np.array([13.12, 5.348, 3.650]),
            angles=np.array([19.07, 19.07, 0.019]),
        ),
        PrintedCycle(
            name="HHDDTNC",
            table=4,
            estimates=_HHDDTNC[0],
            rms=_HHDDTNC[1],
            mean=np.array([270.0, 0.164, 1887.0]),
            sd=np.array([10.5, 0.003, 3.22]),
            log10_eigenvalues=np.array([13.88, 6.034, 5.318]),
            angles=np.array([21.08, 21.08, 0.019]),
        ),
    )
}
DIGITS = np.array([0.1, 0.001, 1.0])  # last printed digit of A, C, m in Tables 2-4
