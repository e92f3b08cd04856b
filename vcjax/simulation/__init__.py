"""Ground truth: worlds, scenarios and simulated recordings. Imports no filter."""
