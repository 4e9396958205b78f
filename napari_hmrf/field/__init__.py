"""Effects of a displacement: moved images, strain, folds, and the inverse motion."""
