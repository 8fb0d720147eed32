"""Pictures and the HTML report: data in, HTML out; nothing here reads or writes files."""
