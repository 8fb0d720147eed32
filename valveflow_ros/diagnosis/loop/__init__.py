"""One control loop judged from its command and what follows it."""
