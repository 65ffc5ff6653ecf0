"""Is the file what its columns say: units, signs, columns, zeros, and the right arm?"""
