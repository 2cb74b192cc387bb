"""An instrument's tips in masks: labelled examples, and how well a source finds them."""
