"""Accept, recover or call dynamic: update gates and detectors behind one contract each."""
