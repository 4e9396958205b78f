"""*Grab and pull*: tissue that follows the mouse."""
