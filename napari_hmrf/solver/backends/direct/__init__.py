"""Direct solution of a linear system, by nested dissection, where cycles cannot be trusted."""
