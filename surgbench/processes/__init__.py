"""Child processes: started, talked to, ended; and what goes on inside them."""
