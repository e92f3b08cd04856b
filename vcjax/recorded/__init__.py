"""One run of a real recording: what it found, as files, and what it is worth."""
