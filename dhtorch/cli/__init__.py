"""The words of the command line. Settings and their composition live here, and nowhere else."""
