"""Pictures of runs: functions that take data and draw."""
