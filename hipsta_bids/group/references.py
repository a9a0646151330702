"""Works that methods of the group level rest on."""

from collections.abc import Mapping

#: Key and entry of each work that the methods rest on.
REFERENCES: Mapping[str, str] = {
    "method": "Diers K, Baumeister H, Jessen F, Düzel E, Berron D, Reuter M. An automated,"
    " geometry-based method for hippocampal shape and thickness analysis. NeuroImage"
    " 2023;276:120182. doi:10.1016/j.neuroimage.2023.120182",
    "registr": "Wrobel J. register: registration for exponential family functional data. Journal"
    " of Open Source Software 2018;3(22):557. doi:10.21105/joss.00557",
    "fdr2": "Benjamini Y, Krieger AM, Yekutieli D. Adaptive linear step-up procedures that"
    " control the false discovery rate. Biometrika 2006;93(3):491-507."
    " doi:10.1093/biomet/93.3.491",
    "bh": "Benjamini Y, Hochberg Y. Controlling the false discovery rate: a"
    " practical and powerful approach to multiple testing. Journal of the Royal Statistical"
    " Society B 1995;57(1):289-300.",
    "permutation": "Winkler AM, Ridgway GR, Webster MA, Smith SM, Nichols TE. Permutation inference"
    " for the general linear model. NeuroImage 2014;92:381-397."
    " doi:10.1016/j.neuroimage.2014.01.060",
    "tfce": "Smith SM, Nichols TE. Threshold-free cluster enhancement: addressing problems of"
    " smoothing, threshold dependence and localisation in cluster inference. NeuroImage"
    " 2009;44(1):83-98. doi:10.1016/j.neuroimage.2008.03.061",
    "mixed": "Kuznetsova A, Brockhoff PB, Christensen RHB. lmerTest package: tests in linear mixed"
    " effects models. Journal of Statistical Software 2017;82(13):1-26."
    " doi:10.18637/jss.v082.i13",
    "asymmetry": "Kong XZ, Mathias SR, Guadalupe T, et al. Mapping cortical brain asymmetry in"
    " 17,141 healthy individuals worldwide via the ENIGMA Consortium. Proceedings of the National"
    " Academy of Sciences 2018;115(22):E5154-E5163. doi:10.1073/pnas.1718418115",
    "normative": "Jack CR, Petersen RC, Xu YC, et al. Medial temporal atrophy on MRI in normal"
    " aging and very mild Alzheimer's disease. Neurology 1997;49(3):786-794."
    " doi:10.1212/WNL.49.3.786",
    "delong": "DeLong ER, DeLong DM, Clarke-Pearson DL. Comparing the areas under two or more"
    " correlated receiver operating characteristic curves: a nonparametric approach. Biometrics"
    " 1988;44(3):837-845.",
    "firth": "Heinze G, Schemper M. A solution to the problem of separation in logistic"
    " regression. Statistics in Medicine 2002;21(16):2409-2419. doi:10.1002/sim.1047",
}
