"""Random deformations of a case, for data augmentation and for the validation of registrations."""
