"""What particle filters compare their particles with: tips, and the straight edges of the shaft."""
