"""What the user sees: a dock widget, in parts that each do one thing."""
