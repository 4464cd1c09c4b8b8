"""What an agent does while it learns: missions, evidence, salient events."""
