"""Direct solution of linear systems by nested dissection, where cycles cannot be trusted."""
