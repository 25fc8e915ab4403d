"""A search for hyper-parameters on inner folds of whole runs, which goes on where it was interrupted."""
