"""Random deformations of a case: training data, and ground truth for validation."""
