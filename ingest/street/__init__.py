"""Street-level views of an anchored place, made from a scan's shape and aerial photos' colours."""
