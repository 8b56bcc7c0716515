"""How each label is made; every export carries these sentences in its manifest."""

from __future__ import annotations

HOW = {
    "box_3d": "box: pose and size that the drive has for the object, exact",
    "velocity": "box: derivative of the object's pose in the world [m/s]",
    "box_2d_modal": "rendered: bounding box of the object's pixels in the instance image, without "
    "blobs of fewer than 8 pixels",
    "box_2d_amodal": "box: bounding box of the projected 3D box, cut at the near plane and at the "
    "border of the image",
    "visibility": "rendered: pixels of the object in the scene over those it fills when it is "
    "drawn alone",
    "truncation": "box: share of the projected 3D box's bounding box outside of the image",
    "instance": "rendered: object of a pixel's front, the Gaussian that takes its light to a fifth "
    "(where that is not reached, or passes draw labels, to a half); an object's shadow is ground",
    "semantic": "rendered: class of the object by its category; of the background the ground by "
    "geometry, within 0.15 m of the scene's height field, the sky by opacity",
    "depth": "rendered: depth along the camera's z axis where a pixel's ray meets its front most; "
    "of the ground that of the scene's height field [m]",
    "flow": "rendered depth and poses: where the surface of a pixel is in the other image; "
    "occluded where the other image shows something else there",
    "points": "rendered: points of the cameras' depth images along the beams of a spinning "
    "LiDAR, only where a camera looks",
    "lidar": "rendered: returns of the LiDAR through the scene's Gaussians, everything where it "
    "is at each ray's instant; the ego's motion is taken out; instance of the Gaussian that takes "
    "half of the ray's light, class by category, the ground by geometry",
    "keypoints": "body: COCO's 17 keypoints of people who are walking bodies, in the world, exact; "
    "in images hidden where nothing of the person is rendered within 0.2 m before them",
    "track": "box: poses of the object at the instants before and after",
    "detections": "box: boxes of the drive, moved, missed and made up as a detector might",
    "ego_future": "box: poses of the ego at the instants after, in the ego's frame",
    "ego": "map: speed of the drive; route and command along the recorded drive",
}
"""What each label is made from: ``rendered``, ``box`` (poses and sizes of the drive)."""
