"""What is derived from a solution: measurements, quantities, motions of points and pictures."""
