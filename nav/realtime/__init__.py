"""Navigation at camera rate: threads, queues, and what is compiled beforehand."""
