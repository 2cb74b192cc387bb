"""What the controllers that solve quadratic programs share: the view and the rules as linear functions of the joints."""
