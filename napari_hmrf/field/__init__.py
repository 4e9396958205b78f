"""Quantities computed from a displacement: warped images, strain, folds, inverse motion."""
