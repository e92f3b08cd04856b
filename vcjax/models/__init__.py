"""What the world is made of: frames, camera, landmarks, motion. Knows no estimator."""
