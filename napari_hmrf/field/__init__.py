"""Functions of arrays on a grid: warped images, strain, folds, inverse motion, followers."""
