"""EKF-SLAM: one frame is `step(config, state, frame) -> (state, info)`, a run is a scan."""
