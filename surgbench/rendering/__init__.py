"""What renders: which of Mitsuba's backends load, and depth by rays."""
