"""Time: clocks, schedules, and the loop whose time jumps."""
