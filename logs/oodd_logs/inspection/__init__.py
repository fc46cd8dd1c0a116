"""Looking at logs before they are imported, and writing a first recipe for them."""
