"""Results of a displacement: warped images, strain, folds and inverses."""
