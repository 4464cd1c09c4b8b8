"""What the agent remembers of its steps."""
