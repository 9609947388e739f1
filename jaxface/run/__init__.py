"""What a run needs of its process: times, kept programs, memory, the machine."""
