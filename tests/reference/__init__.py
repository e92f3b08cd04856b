"""A second opinion: textbook EKF-SLAM in plain NumPy, written without a look at the library it checks."""
