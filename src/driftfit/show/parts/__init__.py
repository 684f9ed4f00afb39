"""What tables and pictures of all results share; it knows runs, and no verb."""
