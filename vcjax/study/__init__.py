"""Many runs: Monte Carlo, sweeps, figures of merit, the paper's experiments, results on disk."""
