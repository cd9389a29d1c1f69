"""The paper's vehicles and its box prior, and the conversion between its units and SI.

The paper writes v in mph, A in lbf, C in lbf/mph^2 and the residual power in hp. Its mass is read as slug, the unit in
which lbf = slug ft/s^2. Parameters are [A, C, m] throughout.
"""

import numpy as np

from estimator.units import STANDARD_GRAVITY

MPH = 0.44704  # m/s
LBF = 0.45359237 * STANDARD_GRAVITY  # N
FOOT = 0.3048  # m
SLUG = LBF / FOOT  # kg
HP = 550 * FOOT * LBF  # W
NAMES = ("A", "C", "m")
PAPER_UNITS = ("lbf", "lbf/mph²", "slug")
SI_UNITS = ("N", "N s²/m²", "kg")

TO_SI = np.array([LBF, LBF / MPH**2, SLUG])
LOWER = np.array([0.0, 0.1, 1000.0]) * TO_SI
UPPER = np.array([500.0, 0.2, 5000.0]) * TO_SI
NOMINAL = np.array([391.0, 0.168, 1863.0]) * TO_SI  # setting of the dynamometer, Table 1
DUMMY = np.array([300.0, 0.15, 2000.0]) * TO_SI  # simulated vehicle of Figures 4-6
