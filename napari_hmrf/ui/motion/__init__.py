"""Tools of the mouse, and tissue that follows them."""
