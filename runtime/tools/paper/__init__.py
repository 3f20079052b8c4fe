"""For papers: tables of figures in LaTeX, Markdown and CSV, and runs as archives that repeat."""
