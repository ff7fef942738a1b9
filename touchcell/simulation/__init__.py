"""What the simulated devices share: surfaces, contact with slip, the tip's marker field and its picture."""
