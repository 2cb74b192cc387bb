"""What every viewpoint controller has to keep to, checked in small worlds made here."""
