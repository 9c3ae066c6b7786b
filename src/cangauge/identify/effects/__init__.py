"""Which effects clean logs show, found by error on logs left out."""
