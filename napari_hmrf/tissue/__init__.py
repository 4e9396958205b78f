"""What is where: materials, stiffness, rules for boundaries, and drawings."""
