"""The Python interface: what `import droguekit` offers."""
