"""The page of live operation: a process of its own that draws what the control process tells it."""
