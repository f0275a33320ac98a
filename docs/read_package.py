"""Prints every array of a model package: python read_package.py MODEL.palpate (needs numpy only)."""
import json, sys, zipfile
import numpy

with zipfile.ZipFile(sys.argv[1]) as package:
    manifest = json.loads(package.read("manifest.json"))
arrays = numpy.load(sys.argv[1])  # a package is also an .npz file
for entry in manifest["entries"]:
    array = arrays[entry["name"].removesuffix(".npy")]
    print(entry["name"], array.dtype.str, array.shape)
