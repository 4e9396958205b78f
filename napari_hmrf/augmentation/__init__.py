"""Random deformations of one case, exact and endless: to learn from, and to validate with."""
