"""Mouse tools, and display of the tissue that the tools move."""
