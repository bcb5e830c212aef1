"""What the boards say: messages, fields, the codec, and reports in bulk."""
