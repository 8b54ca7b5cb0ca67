"""The search for settings that suit a scene and a budget."""
