"""Class-8 drives by NREL's fastsim, and the traffic that a bus would carry of them."""
