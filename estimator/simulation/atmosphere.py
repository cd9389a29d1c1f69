"""Standard atmosphere over altitude, and density of the air.

p = 101325 Pa (1 - 2.25577e-5 h)^5.25588,      rho = p / (R T)           ISO 2533
"""

from estimator.signals import Floats

SEA_LEVEL_PRESSURE = 101_325.0  # Pa
STANDARD_TEMPERATURE = 288.15  # K
LAPSE = 2.25577e-5, 5.25588  # 1/m and exponent


def pressure_at(altitude: Floats) -> Floats:
    """Pressure [Pa] (n,) at altitudes [m] (n,)."""
    lapse, exponent = LAPSE
    pressure: Floats = SEA_LEVEL_PRESSURE * (1.0 - lapse * altitude) ** exponent
    return pressure


def relative_density(pressure: Floats, temperature: Floats) -> Floats:
    """Density (n,) [1] relative to that at sea level and 15 degrees Celsius, for which a truck's C is defined."""
    return pressure / SEA_LEVEL_PRESSURE * STANDARD_TEMPERATURE / temperature
