"""What a user says of a scene, checked as it is said."""
