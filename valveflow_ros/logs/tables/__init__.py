"""Tables of historians: CSV, Excel and Parquet."""
