"""Objects in processes of their own: the worker, its child process, and their shared memory."""
