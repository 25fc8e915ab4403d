"""Cross-validation: protocols, folds, and figures of merit on runs that were held out."""
