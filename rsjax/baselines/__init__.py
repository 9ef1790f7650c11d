"""What rsjax is compared with."""
