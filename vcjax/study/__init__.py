"""Many runs: Monte Carlo, figures of merit, and the paper's experiments."""
