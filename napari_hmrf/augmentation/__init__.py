"""Random deformations of a case, for training data and for validation with ground truth."""
