"""What somebody works on: which model it is."""
