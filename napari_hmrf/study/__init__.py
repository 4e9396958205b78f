"""What somebody works on: which model, and how edits are taken back."""
