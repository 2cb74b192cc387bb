"""What every tracker has to keep to, checked on small scenes made here: ``surgbench check tracker``."""
