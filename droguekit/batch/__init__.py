"""Plan many frames, render them in worker processes, resume after a stop, and reproduce single frames."""
