"""Bayesian road-load estimation from CAN traffic: vehicle mass, rolling resistance and drag."""

__version__ = "0.1.0"
