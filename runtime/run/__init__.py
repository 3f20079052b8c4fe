"""One run: its nodes started, watched and ended, and what it leaves."""
