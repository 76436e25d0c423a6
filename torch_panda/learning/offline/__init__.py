"""Options and loop of offline learning."""
