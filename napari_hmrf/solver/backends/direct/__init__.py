"""Direct solution of linear systems by nested dissection, for use if cycles are not reliable."""
