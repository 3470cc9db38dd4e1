"""Networks: a recipe of a page each."""

from stereokit.models.aanet import aanet, aanet_plus
from stereokit.models.acfnet import acfnet, acfnet_uniform
from stereokit.models.banet import banet_2d, banet_3d
from stereokit.models.casstereo import casstereo_gwc, casstereo_psm
from stereokit.models.cdn import cdn_psmnet
from stereokit.models.coex import coex
from stereokit.models.crl import CRL
from stereokit.models.cspn import cspn
from stereokit.models.deeppruner import DeepPrunerBest, DeepPrunerFast
from stereokit.models.dispnetc import DispNetC
from stereokit.models.fast_acvnet import FastACVNet, FastACVNetPlus
from stereokit.models.ganet import ganet_11, ganet_deep
from stereokit.models.gcnet import gcnet
from stereokit.models.gwcnet import gwcnet_g, gwcnet_gc
from stereokit.models.hd3 import HD3S, HD3SC
from stereokit.models.igev import IGEV, RTIGEV
from stereokit.models.leastereo import leastereo
from stereokit.models.lightstereo import lightstereo_l, lightstereo_m, lightstereo_s
from stereokit.models.mobilestereonet import mobilestereonet_2d, mobilestereonet_3d
from stereokit.models.pdsnet import pdsnet
from stereokit.models.psmnet import psmnet
from stereokit.models.raft_stereo import RAFTStereo, RAFTStereoRealtime
from stereokit.models.segstereo import ResNetCorr, SegStereo
from stereokit.models.stereonet import stereonet_8x, stereonet_16x

__all__ = [
    "CRL",
    "HD3S",
    "HD3SC",
    "IGEV",
    "RTIGEV",
    "DeepPrunerBest",
    "DeepPrunerFast",
    "DispNetC",
    "FastACVNet",
    "FastACVNetPlus",
    "RAFTStereo",
    "RAFTStereoRealtime",
    "ResNetCorr",
    "SegStereo",
    "aanet",
    "aanet_plus",
    "acfnet",
    "acfnet_uniform",
    "banet_2d",
    "banet_3d",
    "casstereo_gwc",
    "casstereo_psm",
    "cdn_psmnet",
    "coex",
    "cspn",
    "ganet_11",
    "ganet_deep",
    "gcnet",
    "gwcnet_g",
    "gwcnet_gc",
    "leastereo",
    "lightstereo_l",
    "lightstereo_m",
    "lightstereo_s",
    "mobilestereonet_2d",
    "mobilestereonet_3d",
    "pdsnet",
    "psmnet",
    "stereonet_8x",
    "stereonet_16x",
]
