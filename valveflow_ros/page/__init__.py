"""A page in the browser about running monitors; everything it shows comes from their messages."""
