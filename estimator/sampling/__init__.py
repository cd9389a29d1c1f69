"""Likelihoods, Metropolis-Hastings kernels and convergence diagnostics; numpy and scipy only."""
