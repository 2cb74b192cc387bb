"""What every instrument tracker has to keep to, checked on small scenes made here."""
