"""Small mistakes put into recorder, recovery and snapshot, to see whether the tests notice."""
