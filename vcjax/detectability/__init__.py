"""Which movers can be told from static features, before anything is run."""
