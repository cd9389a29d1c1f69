"""Results for files and people: draws, tables, pictures, pages, and the words of a diagnosis."""
