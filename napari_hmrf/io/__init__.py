"""Files that people read: figures."""
