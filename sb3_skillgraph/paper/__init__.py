"""Deep Skill Graphs as the paper has it: options with networks of their own, chained by deep skill chaining."""
