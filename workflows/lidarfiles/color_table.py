"""Color scale of values, as data, so that no plotting library is required."""

from __future__ import annotations

import numpy as np

# Turbo by Anton Mikhailov (2019), without its nearly black ends: 256 sRGB colors of three bytes.
_TURBO = bytes.fromhex(
    "4143a74146ac4249b1424bb5434eba4451bf4454c34456c74456c74559cb455ccf455ed34661d64664da"
    "4666dd4669e0466be3466be3476ee64771e94773eb4776ee4778f0477bf2467df44680f64680f64682f8"
    "4685fa4687fb458afc458cfd448ffe4391fe4391fe4294ff4196ff4099ff3e9bfe3d9efe3ba0fd3aa3fc"
    "38a5fb38a5fb37a8fa35abf833adf731aff52fb2f42eb4f22cb7f02cb7f02ab9ee28bceb27bee925c0e7"
    "23c3e422c5e220c7df1fc9dd1fc9dd1ecbda1ccdd81bd0d51ad2d21ad4d019d5cd18d7ca18d7ca18d9c8"
    "18dbc518ddc218dec018e0bd19e2bb19e3b91ae4b61ae4b61ce6b41de7b21fe9af20eaac22ebaa25eca7"
    "27eea42aefa12aefa12cf09e2ff19b32f29835f39438f4913cf58e3ff68a3ff68a43f78746f8844af880"
    "4ef97d52fa7a55fa7659fb735dfc6f5dfc6f61fc6c65fd6969fd666dfe6271fe5f75fe5c79fe5979fe59"
    "7dff5680ff5384ff5188ff4e8bff4b8fff4992ff4796fe4496fe4499fe429cfe409ffd3fa1fd3da4fc3c"
    "a7fc3aa9fb39acfb38acfb38affa37b1f936b4f836b7f735b9f635bcf534bef434bef434c1f334c3f134"
    "c6f034c8ef34cbed34cdec34d0ea34d2e935d2e935d4e735d7e535d9e436dbe236dde037dfdf37e1dd37"
    "e1dd37e3db38e5d938e7d739e9d539ebd339ecd13aeecf3aefcd3aefcd3af1cb3af2c93af4c73af5c53a"
    "f6c33af7c13af8be39f8be39f9bc39faba39fbb838fbb637fcb336fcb136fdae35fdac34fdac34fea933"
    "fea732fea431fea130fe9e2ffe9b2dfe992cfe962bfe962bfe932afe9029fd8d27fd8a26fc8725fc8423"
    "fb8122fb8122fb7e21fa7b1ff9781ef9751df8721cf76f1af66c19f56918f56918f46617f36315f26014"
    "f15d13f05b12ef5811ed5510ed5510ec530feb500eea4e0de84b0ce7490ce5470be4450ae2430ae2430a"
    "e14109df3f08dd3d08dc3b07da3907d83706d63506d63506d43305d23105d02f05ce2d04cc2b04ca2a04"
    "c82803c52603c52603c32503c12302be2102bc2002b91e02b71d02b41b01b21a01b21a01af1801ac1701"
    "a91601a71401a41301a11201"
)
TURBO = np.frombuffer(_TURBO, np.uint8).reshape(256, 3) / 255.0  # (256, 3), from 0 to 1
