"""What stands where and who looks at whom."""
