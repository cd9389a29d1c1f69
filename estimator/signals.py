"""Signals from a bus: time series by role."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimator.roles import DIMENSION as DIMENSION
from estimator.roles import REFERENCES as REFERENCES
from estimator.roles import STATE as STATE
from estimator.roles import Quantity as Quantity
from estimator.roles import Role as Role

Floats = NDArray[np.floating[Any]]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Series:
    """Values of one role at their own times: ``t`` [s], ``value`` [SI unit of the role], both (n,)."""

    t: Floats
    value: Floats


Signals = Mapping[Role, Series]
