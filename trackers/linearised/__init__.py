"""What the controllers that solve quadratic programs share: view and rules as linear functions of the joints."""
