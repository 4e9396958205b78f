"""Tools of the mouse, and display of the tissue that they move."""
