"""The JSON answers of the program as typed structs: types only, so that a program that reads them imports little."""
