"""The mixture of random-walk filters of the default tracker."""
