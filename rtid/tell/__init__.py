"""Everything that is said to a person: sentences, tables, pictures, pages."""
