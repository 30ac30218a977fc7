"""Whether a system makes sense, told before any step."""
