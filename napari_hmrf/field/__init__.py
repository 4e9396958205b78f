"""What a displacement does: moved pictures, strain, and where a point was."""
