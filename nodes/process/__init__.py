"""A program that runs beside the run: started with it, fed by it, ended with it."""
